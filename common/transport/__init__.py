"""Zenoh sessions, endpoints, queries and the router."""
