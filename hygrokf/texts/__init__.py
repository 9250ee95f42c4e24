"""What results say, as codes, and how numbers are written."""

from hygrokf.texts import climate_codes as climate_codes
from hygrokf.texts import discovery_codes as discovery_codes
from hygrokf.texts import doctor_codes as doctor_codes
from hygrokf.texts import fit_codes as fit_codes
from hygrokf.texts import fleet_codes as fleet_codes
from hygrokf.texts import live_codes as live_codes
from hygrokf.texts import reasons as reasons
from hygrokf.texts import record_codes as record_codes
from hygrokf.texts import transfer_codes as transfer_codes
