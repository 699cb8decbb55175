"""The network of the current path: its recipe (`recipe.py`) and what it brings on the four plants (`study.py`)."""
