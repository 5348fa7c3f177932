"""Bodies of furniture and small things from the type and size of an asset, for houses that have no meshes."""
