"""Masks of the pixels that show the world: within the mirror's rim, outside hub and struts."""
