"""The commands of the command line, one function each; `omnid/cli.py` lists them.

Begin with `options.py`: the docstring of a command is its help and declares its options, from which the parser is
built. This is the only package that prints. A mistake of the user ends with exit code 2 and one line: what was asked,
what was found, what to do. Commands import what they need when they run, so that `omnid --help` is quick and `omnid
stop` stays light.
"""
