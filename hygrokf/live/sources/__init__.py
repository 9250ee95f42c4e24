"""Where readings come from: files, MQTT, OPC UA, played-back records; each is one `Stream` of deliveries."""
