"""The paper: what it states, and how each statement is checked."""
