"""omnid as a service of systemd.

`install.py` lists and writes the files of `omnid install-service`: units, udev rules and a first configuration, from
the folder `systemd/`, which the wheel carries. Files that people edit are kept.
"""
