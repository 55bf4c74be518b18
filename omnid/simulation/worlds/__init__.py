"""The worlds that come with the program, for `omnid simulate NAME`; docs/drive.md describes the format."""
