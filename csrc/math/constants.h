// The numbers of the field (Kerbl et al. 2023) that decide which samples a Gaussian touches.
#pragma once

namespace lfgs {

constexpr double kBlurVariancePx = 0.3;  // added to the diagonal of the 2D covariance, px^2
constexpr double kMaxAlpha = 0.99;
constexpr double kMinTransmittance = 1e-4;  // a sample ends before its transmittance falls below
constexpr double kNearDepth = 0.01;         // nearer Gaussians are not drawn
constexpr double kMinAlpha = 1.0 / 255;
constexpr double kLog2MinAlpha = -7.994353436858858;  // log2(1/255)
constexpr double kLog2MaxAlpha = -0.014499569695115;  // log2(0.99)
constexpr double kHalfLog2e = 0.7213475204444817;     // exp(-q/2) = 2^(-kHalfLog2e q)
constexpr double kLn2 = 0.6931471805599453;
constexpr double kPi = 3.141592653589793;

}  // namespace lfgs
