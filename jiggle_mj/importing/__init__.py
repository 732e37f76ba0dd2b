"""Importers of measured data: folders of tracked points become recordings."""
