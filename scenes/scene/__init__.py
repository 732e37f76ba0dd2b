"""What a scene says: sections, attachments, the grasp programme."""
