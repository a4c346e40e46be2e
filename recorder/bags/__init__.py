"""Reading of any robot's bag: its topics as columns of fields."""
