"""Names, headings, starts and frames as one posterior."""
