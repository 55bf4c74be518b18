"""omnid as a service of systemd: its files, which the package carries, and their installation."""
