"""What `lightfield-gs bench` measures: a module for each benchmark, with `add_arguments` and `run`."""
