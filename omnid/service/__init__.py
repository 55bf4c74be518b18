"""omnid as a service of systemd: `install.py` lists and copies the files of `systemd/`, which the wheel carries.

It asks first, `--dry-run` lists what it would do, and a user's own settings file is never overwritten.
"""
