CREATE TABLE alarm (
    id text NOT NULL,
    turbine text NOT NULL,
    kind text NOT NULL,
    severity text NOT NULL,
    began double precision NOT NULL,
    ended double precision,
    acknowledged double precision,
    acknowledged_by text,
    statement text NOT NULL,
    remedy text NOT NULL
);
CREATE VIEW alarm_open AS
 SELECT alarm.id,
    alarm.turbine,
    alarm.kind,
    alarm.severity,
        CASE alarm.severity
            WHEN 'alarm'::text THEN 3
            WHEN 'warning'::text THEN 2
            ELSE 1
        END AS severity_rank,
    alarm.began,
    to_timestamp(alarm.began) AS began_utc,
    to_timestamp(alarm.acknowledged) AS acknowledged_utc,
    alarm.acknowledged_by,
    alarm.statement,
    alarm.remedy
   FROM alarm
  WHERE (alarm.ended IS NULL);
CREATE TABLE claim (
    kind text NOT NULL,
    name text NOT NULL,
    holder bigint NOT NULL,
    who text NOT NULL,
    since double precision NOT NULL
);
CREATE TABLE counter (
    turbine text NOT NULL,
    name text NOT NULL,
    count bigint NOT NULL
);
CREATE TABLE estimate (
    turbine text NOT NULL,
    "time" double precision NOT NULL,
    final integer NOT NULL,
    temperature_k double precision,
    temperature_sd double precision,
    relative_humidity double precision,
    relative_humidity_sd double precision,
    absolute_humidity_g_m3 double precision,
    absolute_humidity_sd double precision,
    dew_point_k double precision,
    dew_point_sd double precision,
    frost_point_k double precision,
    frost_point_sd double precision,
    margin_k double precision,
    margin_sd double precision,
    condensation double precision
);
CREATE VIEW estimate_readable AS
 SELECT estimate.turbine,
    estimate."time",
    to_timestamp(estimate."time") AS time_utc,
    estimate.final,
    (((1.0)::double precision * estimate.temperature_k) + ('-273.15'::numeric)::double precision) AS temperature_celsius,
    ((((1.0)::double precision * estimate.temperature_k) + ('-273.15'::numeric)::double precision) - ((1.959964)::double precision * estimate.temperature_sd)) AS temperature_lower_celsius,
    ((((1.0)::double precision * estimate.temperature_k) + ('-273.15'::numeric)::double precision) + ((1.959964)::double precision * estimate.temperature_sd)) AS temperature_upper_celsius,
    (((100.0)::double precision * estimate.relative_humidity) + (0.0)::double precision) AS relative_humidity_percent,
    ((((100.0)::double precision * estimate.relative_humidity) + (0.0)::double precision) - ((195.9964)::double precision * estimate.relative_humidity_sd)) AS relative_humidity_lower_percent,
    ((((100.0)::double precision * estimate.relative_humidity) + (0.0)::double precision) + ((195.9964)::double precision * estimate.relative_humidity_sd)) AS relative_humidity_upper_percent,
    (((1.0)::double precision * estimate.absolute_humidity_g_m3) + (0.0)::double precision) AS absolute_humidity_g_m3,
    ((((1.0)::double precision * estimate.absolute_humidity_g_m3) + (0.0)::double precision) - ((1.959964)::double precision * estimate.absolute_humidity_sd)) AS absolute_humidity_lower_g_m3,
    ((((1.0)::double precision * estimate.absolute_humidity_g_m3) + (0.0)::double precision) + ((1.959964)::double precision * estimate.absolute_humidity_sd)) AS absolute_humidity_upper_g_m3,
    (((1.0)::double precision * estimate.dew_point_k) + ('-273.15'::numeric)::double precision) AS dew_point_celsius,
    ((((1.0)::double precision * estimate.dew_point_k) + ('-273.15'::numeric)::double precision) - ((1.959964)::double precision * estimate.dew_point_sd)) AS dew_point_lower_celsius,
    ((((1.0)::double precision * estimate.dew_point_k) + ('-273.15'::numeric)::double precision) + ((1.959964)::double precision * estimate.dew_point_sd)) AS dew_point_upper_celsius,
    (((1.0)::double precision * estimate.frost_point_k) + ('-273.15'::numeric)::double precision) AS frost_point_celsius,
    ((((1.0)::double precision * estimate.frost_point_k) + ('-273.15'::numeric)::double precision) - ((1.959964)::double precision * estimate.frost_point_sd)) AS frost_point_lower_celsius,
    ((((1.0)::double precision * estimate.frost_point_k) + ('-273.15'::numeric)::double precision) + ((1.959964)::double precision * estimate.frost_point_sd)) AS frost_point_upper_celsius,
    (((1.0)::double precision * estimate.margin_k) + (0.0)::double precision) AS margin_kelvin,
    ((((1.0)::double precision * estimate.margin_k) + (0.0)::double precision) - ((1.959964)::double precision * estimate.margin_sd)) AS margin_lower_kelvin,
    ((((1.0)::double precision * estimate.margin_k) + (0.0)::double precision) + ((1.959964)::double precision * estimate.margin_sd)) AS margin_upper_kelvin,
    ((100.0)::double precision * estimate.condensation) AS condensation_percent
   FROM estimate;
CREATE TABLE forecast (
    turbine text NOT NULL,
    "time" double precision NOT NULL,
    made double precision NOT NULL,
    temperature_k double precision,
    temperature_sd double precision,
    relative_humidity double precision,
    relative_humidity_sd double precision,
    absolute_humidity_g_m3 double precision,
    absolute_humidity_sd double precision,
    dew_point_k double precision,
    dew_point_sd double precision,
    frost_point_k double precision,
    frost_point_sd double precision,
    margin_k double precision,
    margin_sd double precision,
    condensation double precision,
    above_limit double precision
);
CREATE VIEW forecast_readable AS
 SELECT forecast.turbine,
    forecast."time",
    to_timestamp(forecast."time") AS time_utc,
    to_timestamp(forecast.made) AS made_utc,
    (((1.0)::double precision * forecast.temperature_k) + ('-273.15'::numeric)::double precision) AS temperature_celsius,
    ((((1.0)::double precision * forecast.temperature_k) + ('-273.15'::numeric)::double precision) - ((1.959964)::double precision * forecast.temperature_sd)) AS temperature_lower_celsius,
    ((((1.0)::double precision * forecast.temperature_k) + ('-273.15'::numeric)::double precision) + ((1.959964)::double precision * forecast.temperature_sd)) AS temperature_upper_celsius,
    (((100.0)::double precision * forecast.relative_humidity) + (0.0)::double precision) AS relative_humidity_percent,
    ((((100.0)::double precision * forecast.relative_humidity) + (0.0)::double precision) - ((195.9964)::double precision * forecast.relative_humidity_sd)) AS relative_humidity_lower_percent,
    ((((100.0)::double precision * forecast.relative_humidity) + (0.0)::double precision) + ((195.9964)::double precision * forecast.relative_humidity_sd)) AS relative_humidity_upper_percent,
    (((1.0)::double precision * forecast.absolute_humidity_g_m3) + (0.0)::double precision) AS absolute_humidity_g_m3,
    ((((1.0)::double precision * forecast.absolute_humidity_g_m3) + (0.0)::double precision) - ((1.959964)::double precision * forecast.absolute_humidity_sd)) AS absolute_humidity_lower_g_m3,
    ((((1.0)::double precision * forecast.absolute_humidity_g_m3) + (0.0)::double precision) + ((1.959964)::double precision * forecast.absolute_humidity_sd)) AS absolute_humidity_upper_g_m3,
    (((1.0)::double precision * forecast.dew_point_k) + ('-273.15'::numeric)::double precision) AS dew_point_celsius,
    ((((1.0)::double precision * forecast.dew_point_k) + ('-273.15'::numeric)::double precision) - ((1.959964)::double precision * forecast.dew_point_sd)) AS dew_point_lower_celsius,
    ((((1.0)::double precision * forecast.dew_point_k) + ('-273.15'::numeric)::double precision) + ((1.959964)::double precision * forecast.dew_point_sd)) AS dew_point_upper_celsius,
    (((1.0)::double precision * forecast.frost_point_k) + ('-273.15'::numeric)::double precision) AS frost_point_celsius,
    ((((1.0)::double precision * forecast.frost_point_k) + ('-273.15'::numeric)::double precision) - ((1.959964)::double precision * forecast.frost_point_sd)) AS frost_point_lower_celsius,
    ((((1.0)::double precision * forecast.frost_point_k) + ('-273.15'::numeric)::double precision) + ((1.959964)::double precision * forecast.frost_point_sd)) AS frost_point_upper_celsius,
    (((1.0)::double precision * forecast.margin_k) + (0.0)::double precision) AS margin_kelvin,
    ((((1.0)::double precision * forecast.margin_k) + (0.0)::double precision) - ((1.959964)::double precision * forecast.margin_sd)) AS margin_lower_kelvin,
    ((((1.0)::double precision * forecast.margin_k) + (0.0)::double precision) + ((1.959964)::double precision * forecast.margin_sd)) AS margin_upper_kelvin,
    ((100.0)::double precision * forecast.condensation) AS condensation_percent,
    ((100.0)::double precision * forecast.above_limit) AS above_limit_percent
   FROM forecast;
CREATE TABLE memory (
    turbine text NOT NULL,
    name text NOT NULL,
    content text NOT NULL
);
CREATE TABLE observation (
    turbine text NOT NULL,
    signal text NOT NULL,
    "time" double precision NOT NULL,
    value double precision NOT NULL,
    received double precision NOT NULL,
    late integer NOT NULL,
    contradicted integer NOT NULL
);
CREATE VIEW observation_hourly AS
 SELECT o.turbine,
    o.signal,
    o.hour AS "time",
    to_timestamp(o.hour) AS time_utc,
    avg(o.value) AS mean,
    min(o.value) AS lowest,
    max(o.value) AS highest,
    count(*) AS readings
   FROM ( SELECT observation.turbine,
            observation.signal,
            (floor((observation."time" / (3600)::double precision)) * (3600)::double precision) AS hour,
            observation.value
           FROM observation
          WHERE (observation.contradicted = 0)) o
  GROUP BY o.turbine, o.signal, o.hour;
CREATE TABLE point (
    turbine text NOT NULL,
    "time" double precision NOT NULL,
    state text NOT NULL
);
CREATE TABLE property (
    turbine text NOT NULL,
    "time" double precision NOT NULL,
    name text NOT NULL,
    unit text NOT NULL,
    value double precision,
    lower_bound double precision,
    upper_bound double precision,
    reference double precision NOT NULL,
    observable integer NOT NULL
);
CREATE TABLE turbine (
    name text NOT NULL,
    model text NOT NULL,
    added double precision NOT NULL
);
CREATE VIEW property_now AS
 SELECT p.turbine,
    p.name,
    p.unit,
    p."time",
    to_timestamp(p."time") AS time_utc,
    p.value,
    p.lower_bound,
    p.upper_bound,
    p.reference,
    p.observable
   FROM (( SELECT turbine.name,
            ( SELECT max(n."time") AS max
                   FROM property n
                  WHERE (n.turbine = turbine.name)) AS newest
           FROM turbine) t
     CROSS JOIN property p)
  WHERE ((p.turbine = t.name) AND (p."time" = t.newest));
CREATE TABLE schema_version (
    version integer NOT NULL,
    applied double precision NOT NULL
);
CREATE TABLE source (
    url text NOT NULL,
    place text NOT NULL
);
CREATE VIEW turbine_now AS
 SELECT t.name AS turbine,
    h.heard,
    to_timestamp(h.heard) AS heard_utc,
    e."time",
    e.time_utc,
    e.temperature_celsius,
    e.temperature_lower_celsius,
    e.temperature_upper_celsius,
    e.relative_humidity_percent,
    e.relative_humidity_lower_percent,
    e.relative_humidity_upper_percent,
    e.dew_point_celsius,
    e.margin_kelvin,
    e.margin_lower_kelvin,
    e.condensation_percent,
    ( SELECT count(*) AS count
           FROM alarm a
          WHERE ((a.turbine = t.name) AND (a.ended IS NULL))) AS open_alarms,
    COALESCE(( SELECT max(o.severity_rank) AS max
           FROM alarm_open o
          WHERE (o.turbine = t.name)), 0) AS severity_rank
   FROM ((turbine t
     JOIN ( SELECT turbine.name,
            ( SELECT max(o."time") AS max
                   FROM observation o
                  WHERE (o.turbine = turbine.name)) AS heard
           FROM turbine) h ON ((h.name = t.name)))
     LEFT JOIN estimate_readable e ON (((e.turbine = t.name) AND (e."time" = ( SELECT max(n."time") AS max
           FROM estimate n
          WHERE (n.turbine = t.name))))));
CREATE TABLE weather (
    turbine text NOT NULL,
    signal text NOT NULL,
    "time" double precision NOT NULL,
    value double precision NOT NULL,
    received double precision NOT NULL
);
INSERT INTO alarm VALUES ('a1', 'T1', 'condensation', 'warning', 1700000000, NULL, NULL, NULL, 'water may condense', 'close the door');
INSERT INTO counter VALUES ('T1', 'late', 2);
INSERT INTO counter VALUES ('', 'malformed', 1);
INSERT INTO estimate VALUES ('T1', 1700000000, 1, 290, 0.5, 290, 0.5, 290, 0.5, 290, 0.5, NULL, NULL, 290, 0.5, 0.25);
INSERT INTO estimate VALUES ('T1', 1700000600, 0, 290, 0.5, 290, 0.5, 290, 0.5, 290, 0.5, NULL, NULL, 290, 0.5, 0.25);
INSERT INTO memory VALUES ('T1', 'parameter_shifts', '{"hygric_k": [1.0, 2.0]}');
INSERT INTO observation VALUES ('T1', 'cabinet_temperature', 1700000000, 290.25, 1700000003, 0, 0);
INSERT INTO observation VALUES ('T1', 'cabinet_temperature', 1700000600, 290.5, 1700000603, 0, 0);
INSERT INTO observation VALUES ('T1', 'cabinet_temperature', 1700001200.1234567, 291, 1700001203.1234567, 0, 0);
INSERT INTO observation VALUES ('T1', 'cabinet_temperature', 1700001200.123457, 291, 1700001203.123457, 0, 0);
INSERT INTO observation VALUES ('T1', 'rain', 1700000000.1, 0.30000000000000004, 1700000003.1, 0, 0);
INSERT INTO observation VALUES ('T1', 'rain', 5, 1, 8, 0, 1);
INSERT INTO point VALUES ('T1', 1700000000, '{"mean": [-302.88545506162075, -62.75267246151392, -47.767502974343316, 162.2536754057423, 64.39773675190227], "covariance": [[1.1975196304954403e-09, 0.04032566652845862, -0.021972577717897214, -4.996766935343877e-06, -2.7474682843195844e-06], [0.04032566652845862, 4135286.022748548, -350500.2595141488, -449.63622497803294, -16.875060739650422], [-0.021972577717897214, -350500.2595141488, 2564788.417310523, -21.787220759456392, 18.08615673550276], [-4.996766935343877e-06, -449.63622497803294, -21.787220759456392, 0.06211612688332947, 0.006969116234816825], [-2.7474682843195844e-06, -16.875060739650422, 18.08615673550276, 0.006969116234816825, 0.013336590764042451]]}');
INSERT INTO property VALUES ('T1', 1700000000, 'hygric_k', 'h', 0.3, 0.28, 0.33, 0.31, 1);
INSERT INTO schema_version VALUES (1, 1795546484.0026002);
INSERT INTO schema_version VALUES (2, 1795546484.033784);
INSERT INTO source VALUES ('file:live.csv', '1200');
INSERT INTO turbine VALUES ('T1', 'a', 1795546484.0442522);
INSERT INTO turbine VALUES ('T2', 'b', 1795546484.0504327);
INSERT INTO weather VALUES ('T1', 'ambient_temperature', 1700003600, 280, 1700003603);
ALTER TABLE ONLY alarm
    ADD CONSTRAINT alarm_pkey PRIMARY KEY (id);
ALTER TABLE ONLY claim
    ADD CONSTRAINT claim_pkey PRIMARY KEY (kind, name);
ALTER TABLE ONLY counter
    ADD CONSTRAINT counter_pkey PRIMARY KEY (turbine, name);
ALTER TABLE ONLY estimate
    ADD CONSTRAINT estimate_pkey PRIMARY KEY (turbine, "time");
ALTER TABLE ONLY forecast
    ADD CONSTRAINT forecast_pkey PRIMARY KEY (turbine, "time");
ALTER TABLE ONLY memory
    ADD CONSTRAINT memory_pkey PRIMARY KEY (turbine, name);
ALTER TABLE ONLY observation
    ADD CONSTRAINT observation_pkey PRIMARY KEY (turbine, signal, "time");
ALTER TABLE ONLY point
    ADD CONSTRAINT point_pkey PRIMARY KEY (turbine);
ALTER TABLE ONLY property
    ADD CONSTRAINT property_pkey PRIMARY KEY (turbine, name, "time");
ALTER TABLE ONLY schema_version
    ADD CONSTRAINT schema_version_pkey PRIMARY KEY (version);
ALTER TABLE ONLY source
    ADD CONSTRAINT source_pkey PRIMARY KEY (url);
ALTER TABLE ONLY turbine
    ADD CONSTRAINT turbine_pkey PRIMARY KEY (name);
ALTER TABLE ONLY weather
    ADD CONSTRAINT weather_pkey PRIMARY KEY (turbine, signal, "time");
CREATE INDEX alarm_by_turbine ON alarm USING btree (turbine, began);
CREATE INDEX observation_by_time ON observation USING btree (turbine, "time");
CREATE INDEX property_by_time ON property USING btree (turbine, "time");
