"""The arguments of each command, with what --help says of them; they import nothing that takes long."""
