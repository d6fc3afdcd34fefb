"""Training of the network that fills in what edges of a photo with depths hide, on compositions made in every step."""
