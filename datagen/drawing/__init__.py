"""Pictures of scenes and labels."""
