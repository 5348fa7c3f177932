"""How good methods are: numbers with intervals by scene, over sets of candidates and whole grids."""
