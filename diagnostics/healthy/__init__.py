"""The healthy model: what a healthy cell reads in a contact event, given the readings of the other
cells."""
