"""Campaigns: runs planned, driven over the bus, recorded, checked and kept, so that they can be interrupted and resumed."""
