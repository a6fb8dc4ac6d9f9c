"""Academic floors, generated or from floor plans, where things and people are to be found."""
