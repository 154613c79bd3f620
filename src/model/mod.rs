//! Recipes, training loop, fast forward pass and model artifacts; the only floor that knows candle.
