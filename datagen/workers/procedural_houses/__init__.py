"""Procedural generation of houses: floor plan, rooms, furniture, written as ProcTHOR house documents."""
