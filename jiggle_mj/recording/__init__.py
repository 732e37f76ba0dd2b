"""Recordings as MCAP files: reader, writer, message schemas, and the files of estimate and truth."""
