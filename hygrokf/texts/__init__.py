"""What results say, as codes, and how numbers are written."""

from hygrokf.texts import doctor as doctor
from hygrokf.texts import live as live
