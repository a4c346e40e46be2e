"""Record a drive, check that the sim repeats it bit for bit, and draw it.

python examples/04_watch.py
"""

import mcaprl

mcaprl.record("lane", "drive.mcap", policy="pilot", episodes=1, seed=3, overwrite=True)
comparison = mcaprl.verify("drive.mcap")
print(f"{comparison.steps} steps compared, difference: {comparison.difference}")

# To watch it live in Foxglove: mcaprl.replay("drive.mcap"); for a video: video="drive.webp".
mcaprl.render("drive.mcap", contact_sheet="drive.png", overwrite=True)
layout = mcaprl.layout("drive.mcap", "foxglove-layout.json")
print("drive.png; open drive.mcap in Foxglove or Lichtblick and import foxglove-layout.json")
