"""What the asynchronous and the synchronous client do differently; the rest of them is one code."""
