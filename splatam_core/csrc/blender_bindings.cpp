// The blender as Python sees it (splatam_core/_native.pyi).
#include "blender_bindings.hpp"

#include <pybind11/numpy.h>

#include "blender.hpp"

namespace py = pybind11;
using Array = py::array_t<float, py::array::c_style>;

namespace splatam {
namespace {

std::shared_ptr<TileLists> forward(Blender& blender, const Array& shapes, const Array& features, Array& image) {
  const auto count = std::size_t(shapes.shape(0));
  const int height = int(image.shape(1)), width = int(image.shape(2));
  const float *shape = shapes.data(), *feature = features.data();
  float* drawn = image.mutable_data();
  py::gil_scoped_release release;
  return blender.forward(shape, feature, count, width, height, drawn);
}

void backward(Blender& blender, const TileLists& lists, const Array& shapes, const Array& features, const Array& image,
              const Array& image_gradient, Array& shapes_gradient, Array& features_gradient) {
  const auto count = std::size_t(shapes.shape(0));
  const float *shape = shapes.data(), *feature = features.data(), *drawn = image.data();
  const float* gradient = image_gradient.data();
  float *by_shape = shapes_gradient.mutable_data(), *by_feature = features_gradient.mutable_data();
  py::gil_scoped_release release;
  blender.backward(lists, shape, feature, count, drawn, gradient, by_shape, by_feature);
}

}  // namespace

void bind_blender(py::module_& module) {
  py::class_<TileLists, std::shared_ptr<TileLists>>(module, "TileLists");
  py::class_<Blender>(module, "Blender")
      .def(py::init<int>(), py::arg("threads"))
      .def("forward", &forward, py::arg("shapes"), py::arg("features"), py::arg("image").noconvert())
      .def("backward", &backward, py::arg("lists"), py::kw_only(), py::arg("shapes"), py::arg("features"),
           py::arg("image"), py::arg("image_gradient"), py::arg("shapes_gradient").noconvert(),
           py::arg("features_gradient").noconvert());
}

}  // namespace splatam
