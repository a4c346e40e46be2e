"""mcaprl.recorder"""
