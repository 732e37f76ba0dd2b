"""The contents of a scene: its sections with their checks, the attachments, and the grasp programme."""
