"""The paper's section III: from estimates to a choice."""
