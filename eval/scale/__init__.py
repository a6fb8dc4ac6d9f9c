"""How sweeps scale: what the engine costs, how large a store may be, and what is lost when processes are killed."""
