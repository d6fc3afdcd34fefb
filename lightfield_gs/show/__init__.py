"""Pictures of what an eye sees of a panel."""
