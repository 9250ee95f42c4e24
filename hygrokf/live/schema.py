"""The store's tables, as numbered migrations.

Times are seconds since 1970, UTC, as double precision; values are in SI units, absolute humidity in g/m³.
"""

from __future__ import annotations

MIGRATIONS: tuple[tuple[str, ...], ...] = (
    (
        """CREATE TABLE turbine (
            name TEXT PRIMARY KEY,
            model TEXT NOT NULL,
            added DOUBLE PRECISION NOT NULL)""",
        """CREATE TABLE observation (
            turbine TEXT NOT NULL,
            signal TEXT NOT NULL,
            time DOUBLE PRECISION NOT NULL,
            value DOUBLE PRECISION NOT NULL,
            received DOUBLE PRECISION NOT NULL,
            late INTEGER NOT NULL,
            contradicted INTEGER NOT NULL,
            PRIMARY KEY (turbine, signal, time))""",
        "CREATE INDEX observation_by_time ON observation (turbine, time)",
        """CREATE TABLE point (
            turbine TEXT PRIMARY KEY,
            time DOUBLE PRECISION NOT NULL,
            state TEXT NOT NULL)""",
        """CREATE TABLE estimate (
            turbine TEXT NOT NULL,
            time DOUBLE PRECISION NOT NULL,
            final INTEGER NOT NULL,
            temperature_K DOUBLE PRECISION, temperature_sd DOUBLE PRECISION,
            relative_humidity DOUBLE PRECISION, relative_humidity_sd DOUBLE PRECISION,
            absolute_humidity_g_m3 DOUBLE PRECISION, absolute_humidity_sd DOUBLE PRECISION,
            dew_point_K DOUBLE PRECISION, dew_point_sd DOUBLE PRECISION,
            frost_point_K DOUBLE PRECISION, frost_point_sd DOUBLE PRECISION,
            margin_K DOUBLE PRECISION, margin_sd DOUBLE PRECISION,
            condensation DOUBLE PRECISION,
            PRIMARY KEY (turbine, time))""",
        """CREATE TABLE property (
            turbine TEXT NOT NULL,
            time DOUBLE PRECISION NOT NULL,
            name TEXT NOT NULL,
            unit TEXT NOT NULL,
            value DOUBLE PRECISION, lower_bound DOUBLE PRECISION, upper_bound DOUBLE PRECISION,
            reference DOUBLE PRECISION NOT NULL,
            observable INTEGER NOT NULL,
            PRIMARY KEY (turbine, name, time))""",
        """CREATE TABLE alarm (
            id TEXT PRIMARY KEY,
            turbine TEXT NOT NULL,
            kind TEXT NOT NULL,
            severity TEXT NOT NULL,
            began DOUBLE PRECISION NOT NULL,
            ended DOUBLE PRECISION,
            acknowledged DOUBLE PRECISION,
            acknowledged_by TEXT,
            statement TEXT NOT NULL,
            remedy TEXT NOT NULL)""",
        "CREATE INDEX alarm_by_turbine ON alarm (turbine, began)",
        """CREATE TABLE memory (
            turbine TEXT NOT NULL,
            name TEXT NOT NULL,
            content TEXT NOT NULL,
            PRIMARY KEY (turbine, name))""",
        """CREATE TABLE counter (
            turbine TEXT NOT NULL,
            name TEXT NOT NULL,
            count BIGINT NOT NULL,
            PRIMARY KEY (turbine, name))""",
        """CREATE TABLE source (
            url TEXT PRIMARY KEY,
            place TEXT NOT NULL)""",
    ),
)
"""One tuple of statements a version; a version that was released is never changed, only followed by another."""
VERSION = len(MIGRATIONS)
TABLES = (
    "turbine", "observation", "point", "estimate", "property", "alarm", "memory", "counter", "source"
)  # fmt: skip
"""All tables beside the schema's own."""
