"""Pictures, animations, tables and pages. Reads everything; read by the command line only."""
