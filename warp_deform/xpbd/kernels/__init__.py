"""The forward and the backward kernel, put together from contacts, bodies and springs."""
