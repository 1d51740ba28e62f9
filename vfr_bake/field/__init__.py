"""The field of section 3 of the paper: hash grid, density, head, pilot network."""
