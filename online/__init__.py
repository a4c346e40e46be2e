"""Online learning beside recording. Empty for now: this version learns from logs only.

The package has its place already because the direction of imports is fixed: it will stand on
`sims` and `recorder`, beside `offline`, and neither of the two will import the other.
"""
