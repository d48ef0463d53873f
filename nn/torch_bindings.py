"""Models inside PyTorch: an autograd function and a module. Needs PyTorch, which nothing else here does.

The parameters of the module are a tensor that shares the memory of the model's, so either side may train them.
Gradients flow to the inputs and to the parameters; tensors are shared, not copied, where they are
contiguous and of float32.
"""

from __future__ import annotations

import warp as wp

from nn.model import Model

try:
    import torch
except ImportError:
    raise ImportError("PyTorch is not installed; it comes with pip install '.[bench]'") from None


class Evaluate(torch.autograd.Function):
    """``apply(x, parameters, model, network)``; `parameters` must be the tensor of `Module`."""

    @staticmethod
    def forward(ctx, x, parameters, model, network):
        ctx.model, ctx.network = model, network
        ctx.save_for_backward(x, parameters)
        return model.inference(x.float(), network=network, averaged=False)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, dL_dy):
        model = ctx.model
        x, _ = ctx.saved_tensors
        # The model's own sums are set aside, so that calls may be mixed with its own training.
        kept = wp.clone(model.gradients)
        model.zero_gradients()
        model.forward(x.float(), ctx.network)
        dL_dx = model.backward(dL_dy.float(), input_gradient=ctx.needs_input_grad[0])
        scale = 1.0 / model.statistics["loss_scale"]
        gradient = wp.to_torch(model.gradients).clone() * scale
        wp.copy(model.gradients, kept)
        return (dL_dx * scale if dL_dx is not None else None), gradient, None, None


class Module(torch.nn.Module):
    """A model as a PyTorch module, to be trained by PyTorch's optimisers.

    Args:
        model: The model.
        network: Which of its networks, if there are several.
    """

    def __init__(self, model: Model, network: int = 0):
        super().__init__()
        self.model, self.network = model, network
        self.parameters_flat = torch.nn.Parameter(wp.to_torch(model.parameters, requires_grad=False))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Outputs ``[n, n_output_dims]`` for inputs ``[n, n_input_dims]``."""
        return Evaluate.apply(x, self.parameters_flat, self.model, self.network)
