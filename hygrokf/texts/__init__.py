"""What results say, as codes, and how numbers are written."""

from hygrokf.texts import climate as climate
from hygrokf.texts import discovery as discovery
from hygrokf.texts import doctor as doctor
from hygrokf.texts import fit as fit
from hygrokf.texts import fleet as fleet
from hygrokf.texts import live as live
from hygrokf.texts import record as record
from hygrokf.texts import transfer as transfer
from hygrokf.texts import verdict as verdict
