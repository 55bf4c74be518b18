"""What goes wrong in the daemon."""


class OmnidError(Exception):
    """A request, file or message that cannot be used; one line: asked, found, what to do."""
