"""mcaprl.online"""
