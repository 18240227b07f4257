"""Many robots: the list of them, maintenance of all on workers, and what the fleet needs."""
