"""The benchmarks of `lightfield-gs bench`, a file each: `add_arguments`, and `rows` for the JSON and the text."""
