"""Bodies of furniture and small objects from the type and size of an asset, for houses without meshes."""
