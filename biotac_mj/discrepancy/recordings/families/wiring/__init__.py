"""Channels that are exchanged or reversed, and what an electrode makes of the load."""
