"""Which pixels show the world: the mirror's rim, hub and struts."""
