"""What results say, as codes, and how numbers are written."""

from hygrokf.texts import fit as fit
from hygrokf.texts import record as record
from hygrokf.texts import verdict as verdict
