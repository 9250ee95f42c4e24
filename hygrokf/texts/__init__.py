"""What results say, as codes, and how numbers are written."""
