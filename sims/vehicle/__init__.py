"""Single and batched environments, fleets, pilots and random draws that the sims share."""
