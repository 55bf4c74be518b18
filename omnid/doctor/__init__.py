"""What `omnid doctor` looks at; every check takes plain values and gives findings."""
