"""mcaprl.sims"""
