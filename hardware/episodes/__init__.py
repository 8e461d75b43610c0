"""An episode in a closed loop, who watches it, and which goal it has."""
