"""Write a run as one page for a browser."""
