"""Speed, scale, accuracy and the paper's tables; `figures/` draws the pictures of docs/. Not installed."""
