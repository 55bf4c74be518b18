"""Free floor and things by one posterior for each ray, fused in one grid of cells."""
