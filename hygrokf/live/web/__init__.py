"""The live page and its server: views of the store as JSON, events, metrics, who may see what."""
