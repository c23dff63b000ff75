"""The models of a cooling gas, cheapest first."""
