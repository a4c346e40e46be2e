"""mcaprl.cli"""
