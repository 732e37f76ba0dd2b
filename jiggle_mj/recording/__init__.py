"""Recordings as MCAP files: reading, writing, their messages, estimates and the truth beside them."""
