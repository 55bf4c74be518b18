"""Images of textured worlds by ray casting."""
