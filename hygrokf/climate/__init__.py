"""The climate in a cabinet anywhere: simulated years with bounds, limits, and a test profile that stands for them."""
