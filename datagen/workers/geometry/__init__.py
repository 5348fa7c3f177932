"""Meshes, rigid transforms and planar geometry: arrays in, arrays out."""
