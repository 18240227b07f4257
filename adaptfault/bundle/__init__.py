"""The one folder that a robot carries: versions, the pointer to the active one, and its journal."""
