"""Online training in which sims, replay buffer and networks of all seeds stay on one device."""
