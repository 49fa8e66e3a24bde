// The matcher as Python sees it (splatam_core/_native.pyi).
#include "matcher_bindings.hpp"

#include <pybind11/numpy.h>

#include "arrays.hpp"
#include "matcher.hpp"

namespace py = pybind11;

namespace splatam {
namespace {

py::tuple match_arrays(const py::object& ours, const py::object& others) {
  const py::ssize_t n = length_of(ours, "ours"), m = length_of(others, "others");
  const auto *own = values<std::uint8_t>(ours, "ours", {n, kDescriptor}),
             *other = values<std::uint8_t>(others, "others", {m, kDescriptor});
  py::array_t<std::int32_t> partners(n), distances(n);
  std::int32_t *partner = partners.mutable_data(), *distance = distances.mutable_data();
  {
    py::gil_scoped_release release;
    match(own, std::size_t(n), other, std::size_t(m), partner, distance);
  }
  return py::make_tuple(partners, distances);
}

}  // namespace

void bind_matcher(py::module_& module) { module.def("match", &match_arrays, py::arg("ours"), py::arg("others")); }

}  // namespace splatam
