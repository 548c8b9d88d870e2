"""MVSFormer's feature pyramid: a convolutional encoder and decoder joined with a vision transformer at 1/8."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional as F

CHANNELS = (8, 16, 32, 64)


class ConvBn(nn.Module):
    """Convolution, batch norm, leaky ReLU of slope 0.1 (0: ReLU)."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1, slope: float = 0.1) -> None:
        super().__init__()
        self.slope = slope
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
        self.bn = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return F.leaky_relu(self.bn(self.conv(x)), self.slope)


class PyramidEncoder(nn.Module):
    """(N, 3, H, W) to maps of 8, 16, 32, 64 channels at 1, 1/2, 1/4, 1/8."""

    def __init__(self) -> None:
        super().__init__()
        self.conv00, self.conv01 = ConvBn(3, 8, 7), ConvBn(8, 8, 5)
        self.downsample1, self.conv10, self.conv11 = ConvBn(8, 16, 5, 2), ConvBn(16, 16), ConvBn(16, 16)
        self.downsample2, self.conv20, self.conv21 = ConvBn(16, 32, 5, 2), ConvBn(32, 32), ConvBn(32, 32)
        self.downsample3, self.conv30, self.conv31 = ConvBn(32, 64, 3, 2), ConvBn(64, 64), ConvBn(64, 64)

    def forward(self, x: Tensor) -> list[Tensor]:
        x0 = self.conv01(self.conv00(x))
        x1 = self.conv11(self.conv10(self.downsample1(x0)))
        x2 = self.conv21(self.conv20(self.downsample2(x1)))
        x3 = self.conv31(self.conv30(self.downsample3(x2)))
        return [x0, x1, x2, x3]


class PyramidDecoder(nn.Module):
    """The encoder's maps to features of 64, 32, 16, 8 channels at 1/8, 1/4, 1/2, 1."""

    def __init__(self) -> None:
        super().__init__()
        for k, (outputs, kernel) in enumerate(zip(reversed(CHANNELS), (1, 3, 3, 3))):
            conv = nn.Conv2d(64, outputs, kernel, padding=kernel // 2)
            self.add_module(f"out{k}", nn.Sequential(conv, nn.BatchNorm2d(outputs), nn.SiLU()))
            if k:
                self.add_module(f"inner{k}", nn.Conv2d(outputs, 64, 1))

    def forward(self, maps: list[Tensor]) -> list[Tensor]:
        x = maps[3]
        features = [self.get_submodule("out0")(x)]
        for k in (1, 2, 3):
            x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)
            x = x + self.get_submodule(f"inner{k}")(maps[3 - k])
            features.append(self.get_submodule(f"out{k}")(x))
        return features
