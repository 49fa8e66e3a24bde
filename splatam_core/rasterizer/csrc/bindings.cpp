// Python's view of the engine: numpy arrays in, numpy arrays out, no copies, the GIL released.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

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
                              float cx, float cy, Array& image, Array& depth, Array& silhouette) {
  const auto gaussians = arrays(means, log_scales, logit_opacities, rgb);
  const auto count = std::size_t(means.shape(0));
  const Camera camera{width, height, fx, fy, cx, cy};
  const Pose pose = pose_of(T_cam_world);
  const Images images{image.mutable_data(), depth.mutable_data(), silhouette.mutable_data()};
  py::gil_scoped_release release;
  return engine.forward(gaussians, count, camera, pose, images);
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

}  // namespace
}  // namespace splatam

PYBIND11_MODULE(_native, module) {
  using namespace splatam;
  module.doc() = "The CPU rasterizer's kernels.";
  py::class_<View, std::shared_ptr<View>>(module, "View");
  py::class_<Engine, std::shared_ptr<Engine>>(module, "Engine")
      .def(py::init([](int threads) { return std::make_shared<Engine>(threads); }), py::arg("threads"))
      .def_property_readonly("instruction_set", &Engine::instruction_set)
      .def_property_readonly("threads", &Engine::threads)
      .def("forward", &forward)
      .def("backward", &backward);
}
