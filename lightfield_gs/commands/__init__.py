"""The sub-commands of `lightfield-gs`; lightfield_gs.cli parses their arguments."""
