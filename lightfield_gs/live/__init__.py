"""Pictures while they happen: their sources, the stages that turn them into the panel's picture, and its ways out."""
