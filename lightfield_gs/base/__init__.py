"""What every room stands on: checks, errors, names of choices, paths, devices."""
