// The blender as Python sees it (splatam_core/_native.pyi).
#include "blender_bindings.hpp"

#include <pybind11/numpy.h>

#include <algorithm>

#include "arrays.hpp"
#include "blender.hpp"
#include "kernels.hpp"

namespace py = pybind11;

namespace splatam {
namespace {

std::shared_ptr<TileLists> forward(Blender& blender, const py::object& shapes, const py::object& features,
                                   const py::object& image) {
  const py::ssize_t n = length_of(shapes, "shapes");
  const float *shape = values<float>(shapes, "shapes", {n, kShape}),
              *feature = values<float>(features, "features", {n, kFeatures});
  float* drawn = written<float>(image, "image", {kChannels, kAny, kAny});
  const auto size = py::reinterpret_borrow<py::array>(image);
  const py::ssize_t height = std::min<py::ssize_t>(size.shape(1), kMaxSide + 1),
                    width = std::min<py::ssize_t>(size.shape(2), kMaxSide + 1);  // more is refused by the blender
  py::gil_scoped_release release;
  return blender.forward(shape, feature, std::size_t(n), int(width), int(height), drawn);
}

void backward(Blender& blender, const TileLists& lists, const py::object& shapes, const py::object& features,
              const py::object& image, const py::object& image_gradient, const py::object& shapes_gradient,
              const py::object& features_gradient) {
  const auto n = py::ssize_t(lists.count);
  const py::ssize_t height = lists.height, width = lists.width;
  const float *shape = values<float>(shapes, "shapes", {n, kShape}),
              *feature = values<float>(features, "features", {n, kFeatures});
  const float *drawn = values<float>(image, "image", {kChannels, height, width}),
              *gradient = values<float>(image_gradient, "image_gradient", {kChannels, height, width});
  float *by_shape = written<float>(shapes_gradient, "shapes_gradient", {n, kShape}),
        *by_feature = written<float>(features_gradient, "features_gradient", {n, kFeatures});
  py::gil_scoped_release release;
  blender.backward(lists, shape, feature, lists.count, drawn, gradient, by_shape, by_feature);
}

}  // namespace

void bind_blender(py::module_& module) {
  py::class_<TileLists, std::shared_ptr<TileLists>>(module, "TileLists");
  py::class_<Blender>(module, "Blender")
      .def(py::init([](int threads) { return std::make_unique<Blender>(checked_threads(threads)); }),
           py::arg("threads"))
      .def("forward", &forward, py::arg("shapes"), py::arg("features"), py::arg("image"))
      .def("backward", &backward, py::arg("lists"), py::kw_only(), py::arg("shapes"), py::arg("features"),
           py::arg("image"), py::arg("image_gradient"), py::arg("shapes_gradient"), py::arg("features_gradient"));
}

}  // namespace splatam
