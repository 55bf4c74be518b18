"""Tools that make parts of the documents, and their tests."""
