"""The worlds that come with the program."""
