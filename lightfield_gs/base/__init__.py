"""Tools of all packages: checks, errors, names of choices, paths, devices."""
