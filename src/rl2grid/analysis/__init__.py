"""What evaluations say: statistics, tables, figures and reports."""
