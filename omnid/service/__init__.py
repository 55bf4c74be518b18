"""omnid as a service of systemd: `install.py` copies the files of `systemd/`, which the wheel carries."""
