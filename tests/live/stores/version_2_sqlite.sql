PRAGMA application_id=1752787814;
BEGIN TRANSACTION;
CREATE TABLE alarm (
            id TEXT PRIMARY KEY,
            turbine TEXT NOT NULL,
            kind TEXT NOT NULL,
            severity TEXT NOT NULL,
            began DOUBLE PRECISION NOT NULL,
            ended DOUBLE PRECISION,
            acknowledged DOUBLE PRECISION,
            acknowledged_by TEXT,
            statement TEXT NOT NULL,
            remedy TEXT NOT NULL);
INSERT INTO "alarm" VALUES('a1','T1','condensation','warning',1700000000.0,NULL,NULL,NULL,'water may condense','close the door');
CREATE TABLE claim (
            kind TEXT NOT NULL,
            name TEXT NOT NULL,
            holder BIGINT NOT NULL,
            who TEXT NOT NULL,
            since DOUBLE PRECISION NOT NULL,
            PRIMARY KEY (kind, name));
CREATE TABLE counter (
            turbine TEXT NOT NULL,
            name TEXT NOT NULL,
            count BIGINT NOT NULL,
            PRIMARY KEY (turbine, name));
INSERT INTO "counter" VALUES('T1','late',2);
INSERT INTO "counter" VALUES('','malformed',1);
CREATE TABLE estimate (
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
            PRIMARY KEY (turbine, time));
INSERT INTO "estimate" VALUES('T1',1700000000.0,1,290.0,0.5,290.0,0.5,290.0,0.5,290.0,0.5,NULL,NULL,290.0,0.5,0.25);
INSERT INTO "estimate" VALUES('T1',1700000600.0,0,290.0,0.5,290.0,0.5,290.0,0.5,290.0,0.5,NULL,NULL,290.0,0.5,0.25);
CREATE TABLE forecast (
            turbine TEXT NOT NULL,
            time DOUBLE PRECISION NOT NULL,
            made DOUBLE PRECISION NOT NULL,
            temperature_K DOUBLE PRECISION, temperature_sd DOUBLE PRECISION,
            relative_humidity DOUBLE PRECISION, relative_humidity_sd DOUBLE PRECISION,
            absolute_humidity_g_m3 DOUBLE PRECISION, absolute_humidity_sd DOUBLE PRECISION,
            dew_point_K DOUBLE PRECISION, dew_point_sd DOUBLE PRECISION,
            frost_point_K DOUBLE PRECISION, frost_point_sd DOUBLE PRECISION,
            margin_K DOUBLE PRECISION, margin_sd DOUBLE PRECISION,
            condensation DOUBLE PRECISION,
            above_limit DOUBLE PRECISION,
            PRIMARY KEY (turbine, time));
CREATE TABLE memory (
            turbine TEXT NOT NULL,
            name TEXT NOT NULL,
            content TEXT NOT NULL,
            PRIMARY KEY (turbine, name));
INSERT INTO "memory" VALUES('T1','parameter_shifts','{"hygric_k": [1.0, 2.0]}');
CREATE TABLE observation (
            turbine TEXT NOT NULL,
            signal TEXT NOT NULL,
            time DOUBLE PRECISION NOT NULL,
            value DOUBLE PRECISION NOT NULL,
            received DOUBLE PRECISION NOT NULL,
            late INTEGER NOT NULL,
            contradicted INTEGER NOT NULL,
            PRIMARY KEY (turbine, signal, time));
INSERT INTO "observation" VALUES('T1','cabinet_temperature',1700000000.0,290.25,1700000003.0,0,0);
INSERT INTO "observation" VALUES('T1','cabinet_temperature',1700000600.0,290.5,1700000603.0,0,0);
INSERT INTO "observation" VALUES('T1','cabinet_temperature',1.70000120012345671649e+09,291.0,1.70000120312345671651e+09,0,0);
INSERT INTO "observation" VALUES('T1','cabinet_temperature',1.70000120012345695488e+09,291.0,1.70000120312345695495e+09,0,0);
INSERT INTO "observation" VALUES('T1','rain',1700000000.1,3.00000000000000044408e-01,1700000003.1,0,0);
INSERT INTO "observation" VALUES('T1','rain',5.0,1.0,8.0,0,1);
CREATE TABLE point (
            turbine TEXT PRIMARY KEY,
            time DOUBLE PRECISION NOT NULL,
            state TEXT NOT NULL);
INSERT INTO "point" VALUES('T1',1700000000.0,'{"mean": [-302.88545506162075, -62.75267246151392, -47.767502974343316, 162.2536754057423, 64.39773675190227], "covariance": [[1.1975196304954403e-09, 0.04032566652845862, -0.021972577717897214, -4.996766935343877e-06, -2.7474682843195844e-06], [0.04032566652845862, 4135286.022748548, -350500.2595141488, -449.63622497803294, -16.875060739650422], [-0.021972577717897214, -350500.2595141488, 2564788.417310523, -21.787220759456392, 18.08615673550276], [-4.996766935343877e-06, -449.63622497803294, -21.787220759456392, 0.06211612688332947, 0.006969116234816825], [-2.7474682843195844e-06, -16.875060739650422, 18.08615673550276, 0.006969116234816825, 0.013336590764042451]]}');
CREATE TABLE property (
            turbine TEXT NOT NULL,
            time DOUBLE PRECISION NOT NULL,
            name TEXT NOT NULL,
            unit TEXT NOT NULL,
            value DOUBLE PRECISION, lower_bound DOUBLE PRECISION, upper_bound DOUBLE PRECISION,
            reference DOUBLE PRECISION NOT NULL,
            observable INTEGER NOT NULL,
            PRIMARY KEY (turbine, name, time));
INSERT INTO "property" VALUES('T1',1700000000.0,'hygric_k','h',0.3,0.28,0.33,0.31,1);
CREATE TABLE schema_version (version INTEGER PRIMARY KEY, applied DOUBLE PRECISION NOT NULL);
INSERT INTO "schema_version" VALUES(1,1.79554647772058320045e+09);
INSERT INTO "schema_version" VALUES(2,1.79554647772360777852e+09);
CREATE TABLE source (
            url TEXT PRIMARY KEY,
            place TEXT NOT NULL);
INSERT INTO "source" VALUES('file:live.csv','1200');
CREATE TABLE turbine (
            name TEXT PRIMARY KEY,
            model TEXT NOT NULL,
            added DOUBLE PRECISION NOT NULL);
INSERT INTO "turbine" VALUES('T1','a',1.79554647779200863841e+09);
INSERT INTO "turbine" VALUES('T2','b',1.79554647779207396506e+09);
CREATE TABLE weather (
            turbine TEXT NOT NULL,
            signal TEXT NOT NULL,
            time DOUBLE PRECISION NOT NULL,
            value DOUBLE PRECISION NOT NULL,
            received DOUBLE PRECISION NOT NULL,
            PRIMARY KEY (turbine, signal, time));
INSERT INTO "weather" VALUES('T1','ambient_temperature',1700003600.0,280.0,1700003603.0);
CREATE INDEX observation_by_time ON observation (turbine, time);
CREATE INDEX property_by_time ON property (turbine, time);
CREATE INDEX alarm_by_turbine ON alarm (turbine, began);
CREATE VIEW estimate_readable AS
            SELECT turbine, time, strftime('%Y-%m-%dT%H:%M:%fZ', time, 'unixepoch') AS time_utc, final, 1.0 * temperature_K + (-273.15) AS temperature_celsius, 1.0 * temperature_K + (-273.15) - 1.959964 * temperature_sd AS temperature_lower_celsius, 1.0 * temperature_K + (-273.15) + 1.959964 * temperature_sd AS temperature_upper_celsius, 100.0 * relative_humidity + (0.0) AS relative_humidity_percent, 100.0 * relative_humidity + (0.0) - 195.9964 * relative_humidity_sd AS relative_humidity_lower_percent, 100.0 * relative_humidity + (0.0) + 195.9964 * relative_humidity_sd AS relative_humidity_upper_percent, 1.0 * absolute_humidity_g_m3 + (0.0) AS absolute_humidity_g_m3, 1.0 * absolute_humidity_g_m3 + (0.0) - 1.959964 * absolute_humidity_sd AS absolute_humidity_lower_g_m3, 1.0 * absolute_humidity_g_m3 + (0.0) + 1.959964 * absolute_humidity_sd AS absolute_humidity_upper_g_m3, 1.0 * dew_point_K + (-273.15) AS dew_point_celsius, 1.0 * dew_point_K + (-273.15) - 1.959964 * dew_point_sd AS dew_point_lower_celsius, 1.0 * dew_point_K + (-273.15) + 1.959964 * dew_point_sd AS dew_point_upper_celsius, 1.0 * frost_point_K + (-273.15) AS frost_point_celsius, 1.0 * frost_point_K + (-273.15) - 1.959964 * frost_point_sd AS frost_point_lower_celsius, 1.0 * frost_point_K + (-273.15) + 1.959964 * frost_point_sd AS frost_point_upper_celsius, 1.0 * margin_K + (0.0) AS margin_kelvin, 1.0 * margin_K + (0.0) - 1.959964 * margin_sd AS margin_lower_kelvin, 1.0 * margin_K + (0.0) + 1.959964 * margin_sd AS margin_upper_kelvin, 100.0 * condensation AS condensation_percent FROM estimate;
CREATE VIEW forecast_readable AS
            SELECT turbine, time, strftime('%Y-%m-%dT%H:%M:%fZ', time, 'unixepoch') AS time_utc, strftime('%Y-%m-%dT%H:%M:%fZ', made, 'unixepoch') AS made_utc, 1.0 * temperature_K + (-273.15) AS temperature_celsius, 1.0 * temperature_K + (-273.15) - 1.959964 * temperature_sd AS temperature_lower_celsius, 1.0 * temperature_K + (-273.15) + 1.959964 * temperature_sd AS temperature_upper_celsius, 100.0 * relative_humidity + (0.0) AS relative_humidity_percent, 100.0 * relative_humidity + (0.0) - 195.9964 * relative_humidity_sd AS relative_humidity_lower_percent, 100.0 * relative_humidity + (0.0) + 195.9964 * relative_humidity_sd AS relative_humidity_upper_percent, 1.0 * absolute_humidity_g_m3 + (0.0) AS absolute_humidity_g_m3, 1.0 * absolute_humidity_g_m3 + (0.0) - 1.959964 * absolute_humidity_sd AS absolute_humidity_lower_g_m3, 1.0 * absolute_humidity_g_m3 + (0.0) + 1.959964 * absolute_humidity_sd AS absolute_humidity_upper_g_m3, 1.0 * dew_point_K + (-273.15) AS dew_point_celsius, 1.0 * dew_point_K + (-273.15) - 1.959964 * dew_point_sd AS dew_point_lower_celsius, 1.0 * dew_point_K + (-273.15) + 1.959964 * dew_point_sd AS dew_point_upper_celsius, 1.0 * frost_point_K + (-273.15) AS frost_point_celsius, 1.0 * frost_point_K + (-273.15) - 1.959964 * frost_point_sd AS frost_point_lower_celsius, 1.0 * frost_point_K + (-273.15) + 1.959964 * frost_point_sd AS frost_point_upper_celsius, 1.0 * margin_K + (0.0) AS margin_kelvin, 1.0 * margin_K + (0.0) - 1.959964 * margin_sd AS margin_lower_kelvin, 1.0 * margin_K + (0.0) + 1.959964 * margin_sd AS margin_upper_kelvin, 100.0 * condensation AS condensation_percent,
            100.0 * above_limit AS above_limit_percent FROM forecast;
CREATE VIEW alarm_open AS
            SELECT id, turbine, kind, severity, CASE severity WHEN 'alarm' THEN 3 WHEN 'warning' THEN 2 ELSE 1 END AS severity_rank, began, strftime('%Y-%m-%dT%H:%M:%fZ', began, 'unixepoch') AS began_utc,
            strftime('%Y-%m-%dT%H:%M:%fZ', acknowledged, 'unixepoch') AS acknowledged_utc, acknowledged_by, statement, remedy
            FROM alarm WHERE ended IS NULL;
CREATE VIEW property_now AS
            SELECT p.turbine, p.name, p.unit, p.time, strftime('%Y-%m-%dT%H:%M:%fZ', p.time, 'unixepoch') AS time_utc, p.value, p.lower_bound,
            p.upper_bound, p.reference, p.observable
            FROM (SELECT name, (SELECT MAX(n.time) FROM property n WHERE n.turbine = turbine.name) AS newest
            FROM turbine) t
            CROSS JOIN property p WHERE p.turbine = t.name AND p.time = t.newest;
CREATE VIEW turbine_now AS
            SELECT t.name AS turbine, h.heard, strftime('%Y-%m-%dT%H:%M:%fZ', h.heard, 'unixepoch') AS heard_utc, e.time, e.time_utc,
            e.temperature_celsius, e.temperature_lower_celsius, e.temperature_upper_celsius,
            e.relative_humidity_percent, e.relative_humidity_lower_percent, e.relative_humidity_upper_percent,
            e.dew_point_celsius, e.margin_kelvin, e.margin_lower_kelvin, e.condensation_percent,
            (SELECT COUNT(*) FROM alarm a WHERE a.turbine = t.name AND a.ended IS NULL) AS open_alarms,
            COALESCE((SELECT MAX(o.severity_rank) FROM alarm_open o WHERE o.turbine = t.name), 0)
            AS severity_rank
            FROM turbine t
            JOIN (SELECT name, (SELECT MAX(o.time) FROM observation o WHERE o.turbine = name) AS heard
            FROM turbine) h
            ON h.name = t.name
            LEFT JOIN estimate_readable e ON e.turbine = t.name
            AND e.time = (SELECT MAX(n.time) FROM estimate n WHERE n.turbine = t.name);
CREATE VIEW observation_hourly AS
            SELECT turbine, signal, hour AS time, strftime('%Y-%m-%dT%H:%M:%fZ', hour, 'unixepoch') AS time_utc, AVG(value) AS mean,
            MIN(value) AS lowest,
            MAX(value) AS highest, COUNT(*) AS readings
            FROM (SELECT turbine, signal, CAST(time / 3600 AS INTEGER) * 3600.0 AS hour, value FROM observation
            WHERE contradicted = 0) o
            GROUP BY turbine, signal, hour;
COMMIT;
