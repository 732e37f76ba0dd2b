"""The belief over the attachment stiffnesses."""
