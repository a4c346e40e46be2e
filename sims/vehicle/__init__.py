"""What the sims share: single and batched environments, fleets, seeded draws."""
