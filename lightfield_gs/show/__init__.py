"""Pictures that an eye sees of a panel."""
