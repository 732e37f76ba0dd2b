"""Readers of tracked points: the `[points]` table, text tables, archives, meshes and clouds, and what is unseen."""
