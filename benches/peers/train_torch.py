"""The same net, loss, optimiser and batches as `cargo bench -- train`, by PyTorch on one thread.

Prints one line: seconds of processor time for 10,000 samples, 100 epochs, batch 512.
"""

import time

import torch
from torch import nn

SAMPLES, EPOCHS, BATCH = 10_000, 100, 512
INPUTS, HIDDEN = 4, 32

torch.set_num_threads(1)
torch.manual_seed(1)
encoder = nn.Sequential(nn.Linear(INPUTS, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, 2))
decoder = nn.Sequential(nn.Linear(2, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, INPUTS))
optimiser = torch.optim.Adam([*encoder.parameters(), *decoder.parameters()], lr=0.005)
boxes = torch.randn(SAMPLES, INPUTS)
fixes = boxes[:, :2] * 0.7 + 0.3 * boxes[:, 2:].square()


def epoch() -> float:
    order = torch.randperm(SAMPLES)
    for batch in order.split(BATCH):
        x, z = boxes[batch], fixes[batch]
        regressed = encoder(x)
        rebuilt = decoder(regressed)
        loss = nn.functional.mse_loss(rebuilt, x) + nn.functional.mse_loss(regressed, z)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
    return loss.item()


epoch()
start = time.process_time()
for _ in range(EPOCHS):
    last = epoch()
print(f"{time.process_time() - start:.3f}")
