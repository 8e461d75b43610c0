"""Launches that go on where they were left: clocks, contact lists and grips last between them."""
