// Python's view of the engine: numpy arrays in, numpy arrays out, no copies, the GIL released.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "aligner.hpp"
#include "blender_bindings.hpp"
#include "engine.hpp"

namespace py = pybind11;
using Array = py::array_t<float, py::array::c_style>;  // of another type or layout: a TypeError, never a copy

namespace splatam {
namespace {

GaussianArrays arrays(const Array& means, const Array& log_scales, const Array& logit_opacities, const Array& rgb) {
  return {means.data(), log_scales.data(), logit_opacities.data(), rgb.data()};
}

Pose pose_of(const Array& T) {
  Pose pose;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) pose.R[3 * row + column] = T.at(row, column);
    pose.t[row] = T.at(row, 3);
  }
  return pose;
}

float* optional_data(const py::object& array) { return array.is_none() ? nullptr : array.cast<Array>().mutable_data(); }

std::shared_ptr<View> forward(Engine& engine, const Array& means, const Array& log_scales, const Array& logit_opacities,
                              const Array& rgb, const Array& T_cam_world, int width, int height, float fx, float fy,
                              float cx, float cy, const py::object& bounds, Array& image, Array& depth,
                              Array& silhouette) {
  const auto gaussians = arrays(means, log_scales, logit_opacities, rgb);
  const auto count = std::size_t(means.shape(0));
  const Camera camera{width, height, fx, fy, cx, cy};
  const Pose pose = pose_of(T_cam_world);
  const Images images{image.mutable_data(), depth.mutable_data(), silhouette.mutable_data()};
  const float* limits = optional_data(bounds);
  py::gil_scoped_release release;
  return engine.forward(gaussians, count, limits, camera, pose, images);
}

void backward(Engine& engine, View& view, const Array& means, const Array& log_scales, const Array& logit_opacities,
              const Array& rgb, const std::array<Array, 3>& drawn, const std::array<Array, 3>& gradient,
              const py::object& means_gradient, const py::object& log_scales_gradient,
              const py::object& logit_opacities_gradient, const py::object& rgb_gradient, Array& pose_gradient) {
  const auto gaussians = arrays(means, log_scales, logit_opacities, rgb);
  const ConstImages images{drawn[0].data(), drawn[1].data(), drawn[2].data()};
  const ConstImages slopes{gradient[0].data(), gradient[1].data(), gradient[2].data()};
  const MapGradients map{optional_data(means_gradient), optional_data(log_scales_gradient),
                         optional_data(logit_opacities_gradient), optional_data(rgb_gradient)};
  float* pose = pose_gradient.mutable_data();
  py::gil_scoped_release release;
  engine.backward(view, gaussians, images, slopes, map, pose);
}

double fit(Engine& engine, Array& means, Array& log_scales, Array& logit_opacities, Array& rgb,
           const py::object& bounds, Array& moments, py::array_t<std::uint8_t, py::array::c_style>& steps,
           const std::array<float, 4>& rates, const Array& T_cam_world, float fx, float fy, float cx, float cy,
           const py::array_t<std::uint8_t, py::array::c_style>& target_rgb, const Array& target_depth,
           float color_weight, float depth_weight, float color_limit, float depth_limit) {
  const MutableGaussians gaussians{means.mutable_data(), log_scales.mutable_data(), logit_opacities.mutable_data(),
                                   rgb.mutable_data()};
  const auto count = std::size_t(means.shape(0));
  const Camera camera{int(target_depth.shape(1)), int(target_depth.shape(0)), fx, fy, cx, cy};
  const Pose pose = pose_of(T_cam_world);
  const AdamState adam{moments.mutable_data(), steps.mutable_data()};
  const AdamRates steps_of{rates[0], rates[1], rates[2], rates[3]};
  const Target target{target_rgb.data(), target_depth.data(), color_weight, depth_weight, color_limit, depth_limit};
  float* limits = optional_data(bounds);
  py::gil_scoped_release release;
  return engine.fit(gaussians, count, limits, adam, steps_of, camera, pose, target);
}

// The upper triangle of a symmetric matrix, whole.
py::array_t<double> symmetric(const double* triangle) {
  py::array_t<double> whole({kUnknowns, kUnknowns});
  auto entries = whole.mutable_unchecked<2>();
  for (int row = 0; row < kUnknowns; ++row)
    for (int column = row; column < kUnknowns; ++column)
      entries(row, column) = entries(column, row) = *triangle++;
  return whole;
}

py::tuple linearize(Aligner& aligner, const Array& brightness, const Array& depth, const Array& layers, float fx,
                    float fy, float cx, float cy, const Array& light_motion, const Array& depth_motion,
                    const Array& velocity, float gain, float bias, float light_scale, float depth_scale,
                    float max_depth_ratio, float inlier_light, float inlier_depth) {
  const Camera camera{int(brightness.shape(1)), int(brightness.shape(0)), fx, fy, cx, cy};
  const float* v = velocity.data();
  const AlignmentSettings settings{gain,        bias,        {v[0], v[1], v[2], v[3], v[4], v[5]},
                                   light_scale, depth_scale, max_depth_ratio,
                                   inlier_light, inlier_depth};
  const Pose light_pose = pose_of(light_motion), depth_pose = pose_of(depth_motion);
  Aligner::Result result;
  {
    py::gil_scoped_release release;
    result = aligner.linearize(brightness.data(), depth.data(), camera, layers.data(), light_pose, depth_pose, settings);
  }
  const auto& sums = result.sums;
  return py::make_tuple(symmetric(sums.H), py::array_t<double>(kUnknowns, sums.g), sums.cost, sums.points,
                        sums.compared, sums.seen, sums.agreeing, result.light_median, result.depth_median);
}

py::tuple halve(Aligner& aligner, const Array& brightness, const Array& depth, float max_step) {
  const int width = int(brightness.shape(1)), height = int(brightness.shape(0));
  Array half_brightness({height / 2, width / 2}), half_depth({height / 2, width / 2});
  aligner.halve(brightness.data(), depth.data(), width, height, max_step, half_brightness.mutable_data(),
                half_depth.mutable_data());
  return py::make_tuple(half_brightness, half_depth);
}

Array layers(Aligner& aligner, const Array& brightness, const Array& depth, float max_step) {
  const int width = int(brightness.shape(1)), height = int(brightness.shape(0));
  Array result({height, width, kLayers});
  aligner.layers(brightness.data(), depth.data(), width, height, max_step, result.mutable_data());
  return result;
}

}  // namespace
}  // namespace splatam

PYBIND11_MODULE(_native, module) {
  using namespace splatam;
  module.attr("BLOCK") = kBlock;
  module.doc() = "The CPU rasterizer's kernels.";
  py::class_<View, std::shared_ptr<View>>(module, "View");
  py::class_<Engine, std::shared_ptr<Engine>>(module, "Engine")
      .def(py::init([](int threads) { return std::make_shared<Engine>(threads); }), py::arg("threads"))
      .def_property_readonly("instruction_set", &Engine::instruction_set)
      .def("forward", &forward)
      .def("backward", &backward)
      .def("fit", &fit);
  py::class_<Aligner>(module, "Aligner")
      .def(py::init<int>(), py::arg("threads"))
      .def("linearize", &linearize)
      .def("halve", &halve)
      .def("layers", &layers);
  bind_blender(module);
}
