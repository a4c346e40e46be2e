"""mcaprl.offline"""
