"""What the page in the browser shows of policies: where they look, and what they played."""
