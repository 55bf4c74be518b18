"""The commands of the command line; `omnid/cli.py` lists them."""
