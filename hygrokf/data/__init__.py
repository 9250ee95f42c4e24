"""What a record is: signals with units, series on their own clocks, time stamps, masks, the courses between
readings.

Nothing here knows a model.
"""
