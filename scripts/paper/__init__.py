"""The paper's experiment: its tables, figures and networks."""
