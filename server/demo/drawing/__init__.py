"""Pictures of what the demo found."""
