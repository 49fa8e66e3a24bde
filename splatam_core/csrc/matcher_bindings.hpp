#pragma once

#include <pybind11/pybind11.h>

namespace splatam {

void bind_matcher(pybind11::module_& module);

}  // namespace splatam
