"""What the sub-commands of `lightfield-gs` do; lightfield_gs.cli parses their arguments."""
