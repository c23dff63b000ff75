"""Validation of user input, traced values, the status of compiled code, and tables for display.

The lowest package: it imports no other package of jaxgran, and every other package may import it.
"""
