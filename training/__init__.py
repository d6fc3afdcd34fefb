"""Training of the network inside the panel's viewing cone; not needed to use lightfield_gs."""
