"""Notification: alarms by mail and webhook, from the store's outbox."""
