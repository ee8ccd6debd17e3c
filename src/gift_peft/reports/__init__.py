"""What people look at: tables, figures and model cards of runs."""
