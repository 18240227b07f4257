"""How cells age: their condition over the runs of a robot, trends, and lifetimes over a fleet."""
