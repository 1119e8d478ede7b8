"""From run folders to tables, figures and the page."""
