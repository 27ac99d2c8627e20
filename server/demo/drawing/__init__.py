"""Pictures of the demo's findings."""
