// The engine and the aligner as Python sees them (splatam_core/_native.pyi): numpy arrays in, numpy arrays out, no
// copies of what is written to, the GIL released.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <optional>

#include "aligner.hpp"
#include "blender_bindings.hpp"
#include "engine.hpp"

namespace py = pybind11;
using Array = py::array_t<float, py::array::c_style>;
using ByteArray = py::array_t<std::uint8_t, py::array::c_style>;

namespace splatam {
namespace {

// Intrinsics of a PinholeCamera, and the size of the image it is used for.
Camera camera_of(const py::object& camera, py::ssize_t width, py::ssize_t height) {
  const auto intrinsic = [&](const char* name) { return camera.attr(name).cast<float>(); };
  return {int(width), int(height), intrinsic("fx"), intrinsic("fy"), intrinsic("cx"), intrinsic("cy")};
}

Pose pose_of(const Array& T) {
  Pose pose;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) pose.R[3 * row + column] = T.at(row, column);
    pose.t[row] = T.at(row, 3);
  }
  return pose;
}

float* data_or_null(std::optional<Array>& array) { return array ? array->mutable_data() : nullptr; }

std::shared_ptr<View> forward(Engine& engine, const Array& means, const Array& log_scales, const Array& logit_opacities,
                              const Array& rgb, std::optional<Array> bounds, const Array& T_cam_world,
                              const py::object& camera, Array& image, Array& depth, Array& silhouette) {
  const GaussianArrays gaussians{means.data(), log_scales.data(), logit_opacities.data(), rgb.data()};
  const auto count = std::size_t(means.shape(0));
  const Camera pinhole = camera_of(camera, depth.shape(1), depth.shape(0));
  const Pose pose = pose_of(T_cam_world);
  const Images images{image.mutable_data(), depth.mutable_data(), silhouette.mutable_data()};
  const float* limits = data_or_null(bounds);
  py::gil_scoped_release release;
  return engine.forward(gaussians, count, limits, pinhole, pose, images);
}

void backward(Engine& engine, View& view, const Array& means, const Array& log_scales, const Array& logit_opacities,
              const Array& rgb, const std::array<Array, 3>& images, const std::array<Array, 3>& image_gradients,
              std::optional<Array> means_gradient, std::optional<Array> log_scales_gradient,
              std::optional<Array> logit_opacities_gradient, std::optional<Array> rgb_gradient, Array& pose_gradient) {
  const GaussianArrays gaussians{means.data(), log_scales.data(), logit_opacities.data(), rgb.data()};
  const ConstImages drawn{images[0].data(), images[1].data(), images[2].data()};
  const ConstImages gradients{image_gradients[0].data(), image_gradients[1].data(), image_gradients[2].data()};
  const MapGradients map{data_or_null(means_gradient), data_or_null(log_scales_gradient),
                         data_or_null(logit_opacities_gradient), data_or_null(rgb_gradient)};
  float* pose = pose_gradient.mutable_data();
  py::gil_scoped_release release;
  engine.backward(view, gaussians, drawn, gradients, map, pose);
}

double fit(Engine& engine, Array& means, Array& log_scales, Array& logit_opacities, Array& rgb,
           std::optional<Array> bounds, Array& moments, ByteArray& steps, const std::array<float, 4>& rates,
           const Array& T_cam_world, const py::object& camera, const ByteArray& target_rgb, const Array& target_depth,
           float color_weight, float depth_weight, float color_limit, float depth_limit) {
  const MutableGaussians gaussians{means.mutable_data(), log_scales.mutable_data(), logit_opacities.mutable_data(),
                                   rgb.mutable_data()};
  const auto count = std::size_t(means.shape(0));
  const Camera pinhole = camera_of(camera, target_depth.shape(1), target_depth.shape(0));
  const Pose pose = pose_of(T_cam_world);
  const AdamState adam{moments.mutable_data(), steps.mutable_data()};
  const AdamRates step_sizes{rates[0], rates[1], rates[2], rates[3]};
  const Target target{target_rgb.data(), target_depth.data(), color_weight, depth_weight, color_limit, depth_limit};
  float* limits = data_or_null(bounds);
  py::gil_scoped_release release;
  return engine.fit(gaussians, count, limits, adam, step_sizes, pinhole, pose, target);
}

// Aligner::Result as Python sees it.
struct LinearSystem {
  py::array_t<double> H, g;  // [kUnknowns, kUnknowns], [kUnknowns]
  double cost;
  std::int64_t points, compared, seen, agreeing;
  float photometric_median, depth_median;
};

// Expands the upper triangle of a symmetric matrix.
py::array_t<double> symmetric(const double* triangle) {
  py::array_t<double> whole({kUnknowns, kUnknowns});
  auto entries = whole.mutable_unchecked<2>();
  for (int row = 0; row < kUnknowns; ++row)
    for (int column = row; column < kUnknowns; ++column) entries(row, column) = entries(column, row) = *triangle++;
  return whole;
}

LinearSystem linearize(Aligner& aligner, const Array& brightness, const Array& depth, const Array& layers,
                       const py::object& camera, const Array& color_motion, const Array& depth_motion,
                       const Array& velocity, float gain, float bias, float photometric_scale, float depth_scale,
                       float max_depth_ratio, float inlier_color, float inlier_depth) {
  const Camera pinhole = camera_of(camera, brightness.shape(1), brightness.shape(0));
  const float* v = velocity.data();
  const AlignmentSettings settings{
      gain,         bias,        {v[0], v[1], v[2], v[3], v[4], v[5]}, photometric_scale, depth_scale, max_depth_ratio,
      inlier_color, inlier_depth};
  const Pose color_pose = pose_of(color_motion), depth_pose = pose_of(depth_motion);
  Aligner::Result result;
  {
    py::gil_scoped_release release;
    result =
        aligner.linearize(brightness.data(), depth.data(), pinhole, layers.data(), color_pose, depth_pose, settings);
  }
  const auto& sums = result.sums;
  return {symmetric(sums.H),  py::array_t<double>(kUnknowns, sums.g),
          sums.cost,          sums.points,
          sums.compared,      sums.seen,
          sums.agreeing,      result.photometric_median,
          result.depth_median};
}

py::tuple halve(Aligner& aligner, const Array& brightness, const Array& depth, float max_step) {
  const int width = int(brightness.shape(1)), height = int(brightness.shape(0));
  Array half_brightness({height / 2, width / 2}), half_depth({height / 2, width / 2});
  aligner.halve(brightness.data(), depth.data(), width, height, max_step, half_brightness.mutable_data(),
                half_depth.mutable_data());
  return py::make_tuple(half_brightness, half_depth);
}

Array fill_holes(Aligner& aligner, const Array& depth, int max_gap, float max_step) {
  const int width = int(depth.shape(1)), height = int(depth.shape(0));
  Array result({height, width});
  std::copy(depth.data(), depth.data() + depth.size(), result.mutable_data());
  aligner.fill_holes(result.mutable_data(), width, height, max_gap, max_step);
  return result;
}

Array layers(Aligner& aligner, const Array& brightness, const Array& depth, float max_step) {
  const int width = int(brightness.shape(1)), height = int(brightness.shape(0));
  Array result({height, width, kLayers});
  aligner.layers(brightness.data(), depth.data(), width, height, max_step, result.mutable_data());
  return result;
}

void bind_engine(py::module_& module) {
  // Arrays that are written to are marked noconvert: of another type or layout they are a TypeError, since pybind11
  // would pass a copy instead.
  py::class_<View, std::shared_ptr<View>>(module, "View");
  py::class_<Engine, std::shared_ptr<Engine>>(module, "Engine")
      .def(py::init([](int threads) { return std::make_shared<Engine>(threads); }), py::arg("threads"))
      .def_property_readonly("instruction_set", &Engine::instruction_set)
      .def("forward", &forward, py::kw_only(), py::arg("means"), py::arg("log_scales"), py::arg("logit_opacities"),
           py::arg("rgb"), py::arg("bounds"), py::arg("T_cam_world"), py::arg("camera"), py::arg("image").noconvert(),
           py::arg("depth").noconvert(), py::arg("silhouette").noconvert())
      .def("backward", &backward, py::arg("view"), py::kw_only(), py::arg("means"), py::arg("log_scales"),
           py::arg("logit_opacities"), py::arg("rgb"), py::arg("images"), py::arg("image_gradients"),
           py::arg("means_gradient").noconvert(), py::arg("log_scales_gradient").noconvert(),
           py::arg("logit_opacities_gradient").noconvert(), py::arg("rgb_gradient").noconvert(),
           py::arg("pose_gradient").noconvert())
      .def("fit", &fit, py::kw_only(), py::arg("means").noconvert(), py::arg("log_scales").noconvert(),
           py::arg("logit_opacities").noconvert(), py::arg("rgb").noconvert(), py::arg("bounds").noconvert(),
           py::arg("moments").noconvert(), py::arg("steps").noconvert(), py::arg("rates"), py::arg("T_cam_world"),
           py::arg("camera"), py::arg("target_rgb"), py::arg("target_depth"), py::arg("color_weight"),
           py::arg("depth_weight"), py::arg("color_limit"), py::arg("depth_limit"));
}

void bind_aligner(py::module_& module) {
  py::class_<LinearSystem>(module, "LinearSystem")
      .def_readonly("H", &LinearSystem::H)
      .def_readonly("g", &LinearSystem::g)
      .def_readonly("cost", &LinearSystem::cost)
      .def_readonly("points", &LinearSystem::points)
      .def_readonly("compared", &LinearSystem::compared)
      .def_readonly("seen", &LinearSystem::seen)
      .def_readonly("agreeing", &LinearSystem::agreeing)
      .def_readonly("photometric_median", &LinearSystem::photometric_median)
      .def_readonly("depth_median", &LinearSystem::depth_median);
  py::class_<Aligner>(module, "Aligner")
      .def(py::init<int>(), py::arg("threads"))
      .def("linearize", &linearize, py::arg("brightness"), py::arg("depth"), py::arg("layers"), py::kw_only(),
           py::arg("camera"), py::arg("color_motion"), py::arg("depth_motion"), py::arg("velocity"), py::arg("gain"),
           py::arg("bias"), py::arg("photometric_scale"), py::arg("depth_scale"), py::arg("max_depth_ratio"),
           py::arg("inlier_color"), py::arg("inlier_depth"))
      .def("halve", &halve, py::arg("brightness"), py::arg("depth"), py::arg("max_step"))
      .def("fill_holes", &fill_holes, py::arg("depth"), py::arg("max_gap"), py::arg("max_step"))
      .def("layers", &layers, py::arg("brightness"), py::arg("depth"), py::arg("max_step"));
}

}  // namespace
}  // namespace splatam

PYBIND11_MODULE(_native, module) {
  using namespace splatam;
  module.doc() = "The CPU rasterizer's and the alignment's kernels.";
  module.attr("BLOCK") = kBlock;
  bind_engine(module);
  bind_aligner(module);
  bind_blender(module);
}
